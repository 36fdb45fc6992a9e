"""A moving run as one page that turns and scrubs in a browser: the animated glTF and what draws it, no network.

The viewer is three.js with its glTF loader and trackball controls, as trimesh carries them in its own template for
notebooks; trimesh is needed anyway, so nothing more is installed. What is ours is the bar below: a slider over the
frames, a button that plays them, and a box for each muscle and bone.
"""

from __future__ import annotations

import base64
import html
import json
import zipfile
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any

from rbfmuscle.output.animation.gltf import animated_glb
from rbfmuscle.output.animation.moving import FRAMES_A_SECOND, MovingRun
from rbfmuscle.validation import MissingPartError

# Where the library ends and the page of trimesh's own begins.
_BEGIN, _END = "<script>", "THREE.GLTFLoader=GLTFLoader;})();"
_CLOSING = "</script"

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
html,body{{margin:0;height:100%;overflow:hidden;background:#fbfaf8;color:#26282b;
font:15px/1.4 system-ui,"Segoe UI",Helvetica,Arial,sans-serif}}
#view{{position:absolute;inset:0 0 76px 0}}
#bar{{position:absolute;left:0;right:0;bottom:0;height:76px;box-sizing:border-box;padding:8px 16px;background:#fff;
border-top:1px solid #e5e3de}}
#row{{display:flex;gap:14px;align-items:center}}
#frame{{flex:1}}
#caption{{min-width:22ch;font-variant-numeric:tabular-nums}}
#names{{display:flex;flex-wrap:nowrap;gap:14px;overflow-x:auto;font-size:13.5px;white-space:nowrap;padding-top:6px}}
#names i{{display:inline-block;width:11px;height:11px;border-radius:3px;margin:0 4px 0 2px}}
#view p{{padding:24px;max-width:70ch}}
button{{font:inherit;min-width:6ch;padding:3px 10px}}
</style>
</head>
<body>
<div id="view"></div>
<div id="bar"><div id="row"><button id="play" type="button">Play</button>
<input id="frame" type="range" min="0" max="{last}" value="0" step="1" aria-label="frame">
<span id="caption"></span></div><div id="names"></div></div>
<script id="told" type="application/json">{told}</script>
<script id="model" type="model/gltf-binary;base64">{model}</script>
<script>{library}</script>
<script>{script}</script>
</body>
</html>
"""

_SCRIPT = """
(function(){
"use strict";
const told=JSON.parse(document.getElementById("told").textContent);
const view=document.getElementById("view"),slider=document.getElementById("frame");
const caption=document.getElementById("caption"),play=document.getElementById("play");
function fail(error){const p=document.createElement("p");
p.textContent="This page needs WebGL 2 to draw: "+error;view.append(p);}
function bytes(){const text=atob(document.getElementById("model").textContent.trim());
const found=new Uint8Array(text.length);
for(let k=0;k<text.length;k++)found[k]=text.charCodeAt(k);return found.buffer;}
let renderer;
try{renderer=new THREE.WebGLRenderer({antialias:true});}catch(error){fail(error);return;}
const scene=new THREE.Scene(),camera=new THREE.PerspectiveCamera(30,1,0.001,1000);
scene.background=new THREE.Color(0xfbfaf8);
scene.add(new THREE.HemisphereLight(0xffffff,0xb8b0a8,0.55));
const light=new THREE.DirectionalLight(0xffffff,0.75);scene.add(light);
renderer.outputEncoding=THREE.sRGBEncoding;
renderer.setPixelRatio(window.devicePixelRatio);
view.append(renderer.domElement);
const controls=new THREE.TrackballControls(camera,renderer.domElement);
controls.rotateSpeed=2.5;controls.dynamicDampingFactor=0.25;
function draw(){light.position.copy(camera.position);renderer.render(scene,camera);}
function fit(){const w=view.clientWidth||1,h=view.clientHeight||1;camera.aspect=w/h;
camera.updateProjectionMatrix();renderer.setSize(w,h);controls.handleResize();draw();}
new THREE.GLTFLoader().parse(bytes(),"",function(gltf){
scene.add(gltf.scene);
const actions=[],mixer=new THREE.AnimationMixer(gltf.scene);
gltf.animations.forEach(function(clip){const action=mixer.clipAction(clip);action.play();actions.push(action);});
const box=new THREE.Box3().setFromObject(gltf.scene),ball=box.getBoundingSphere(new THREE.Sphere());
controls.target.copy(ball.center);
const away=1.15*ball.radius/Math.sin(0.5*camera.fov*Math.PI/180);
camera.position.copy(ball.center).add(new THREE.Vector3(0.45,0.12,0.88).normalize().multiplyScalar(away));
camera.near=0.01*away;camera.far=10*away;
function show(k){actions.forEach(function(action){action.time=told.times[k];});mixer.update(0);
caption.textContent=told.captions[k];draw();}
slider.oninput=function(){show(Number(slider.value));};
let started=null,from=0;
play.onclick=function(){if(started!==null){started=null;play.textContent="Play";return;}
play.textContent="Stop";started=performance.now();from=Number(slider.value);};
function step(now){requestAnimationFrame(step);controls.update();
if(started!==null){const last=told.times.length-1;
const k=(from+Math.floor((now-started)/1000*told.rate))%(last+1);
if(k!==Number(slider.value)){slider.value=k;show(k);}}}
controls.addEventListener("change",draw);
const names=document.getElementById("names");
told.parts.forEach(function(part){let node=null;
gltf.scene.traverse(function(one){if(one.userData.name===part.name&&!node)node=one;});
const label=document.createElement("label"),box=document.createElement("input"),dot=document.createElement("i");
box.type="checkbox";box.checked=true;dot.style.background=part.colour;
box.onchange=function(){node.visible=box.checked;draw();};
label.append(box,dot,part.name);names.append(label);});
window.addEventListener("resize",fit);
fit();show(0);requestAnimationFrame(step);
window.rbfmuscle={scene:gltf.scene,show:show,frames:told.times.length};
},fail);
})();
"""


def write_animated_page(path: Path, run: MovingRun, captions: list[str]) -> None:
    """Write a run as one ``.html`` file that needs nothing else.

    Parameters
    ----------
    path : pathlib.Path
    run : MovingRun
        In metres.
    captions : list of str
        What is said of each frame.

    Raises
    ------
    UsageError
        If a muscle's surface has other vertices in other frames.
    MissingPartError
        If the trimesh that is installed brings no viewer.
    """
    library = viewer_library()
    times = [float(t) for t in run.times - run.times[0]]
    shown: list[Any] = [*run.muscles, *run.bones]
    parts = [
        {"name": part.name, "colour": "#" + "".join(f"{round(255 * float(c)):02x}" for c in part.colour)}
        for part in shown
    ]
    told = {"times": times, "captions": captions, "parts": parts, "rate": FRAMES_A_SECOND / 2.0}
    page = _PAGE.format(
        title=html.escape(run.name),
        last=len(times) - 1,
        # No name may end the script that holds it.
        told=json.dumps(told).replace("<", "\\u003c"),
        model=base64.b64encode(animated_glb(run, "html")).decode("ascii"),
        library=library,
        script=_SCRIPT,
    )
    path.write_text(page, encoding="utf-8")


def viewer_library() -> str:
    """three.js with a loader of glTF and trackball controls, as one script.

    Raises
    ------
    MissingPartError
        If the trimesh that is installed does not bring it.
    """
    try:
        packed = (resources.files("trimesh.resources") / "templates" / "viewer.zip").read_bytes()
        with zipfile.ZipFile(BytesIO(packed)) as archive:
            template = archive.read("viewer.html.template").decode("utf-8")
        start = template.index(_BEGIN) + len(_BEGIN)
        library = template[start : template.index(_END, start) + len(_END)]
    except (OSError, KeyError, ValueError, ModuleNotFoundError, zipfile.BadZipFile):
        raise MissingPartError(
            "export to html takes its viewer from trimesh, and the version installed brings none that is known; "
            "pip install 'trimesh>=4.6.4,<6', or export to animated-glb"
        ) from None
    # A script must not hold its own closing tag.
    return library.replace(_CLOSING, "<\\/script")
