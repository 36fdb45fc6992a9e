"""Models and reference values of OpenSim, where they are; and a small model that is always here."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

SMALL = """<?xml version="1.0" encoding="UTF-8"?>
<OpenSimDocument Version="40000">
 <Model name="small leg">
  <defaults><Coordinate name="decoy"/></defaults>
  <Ground name="ground"/>
  <length_units>meters</length_units>
  <BodySet name="bodyset"><objects>
   <Body name="thigh">
    <attached_geometry>
     <Mesh name="m"><scale_factors>1 1 -2</scale_factors><mesh_file>wedge.obj</mesh_file></Mesh>
     <Mesh name="h"><Appearance><visible>false</visible></Appearance><mesh_file>wedge.obj</mesh_file></Mesh>
     <Mesh name="n"><mesh_file>nowhere.vtp</mesh_file></Mesh>
    </attached_geometry>
   </Body>
   <Body name="shank">
    <attached_geometry><Mesh name="m"><mesh_file>wedge.obj</mesh_file></Mesh></attached_geometry>
   </Body>
   <Body name="cap"/>
  </objects></BodySet>
  <JointSet name="jointset"><objects>
   <CustomJoint name="knee">
    <socket_parent_frame>offset</socket_parent_frame>
    <socket_child_frame>/bodyset/shank</socket_child_frame>
    <coordinates>
     <Coordinate name="knee_angle">
      <default_value>-0.5</default_value><range>-2 0.2</range><clamped>true</clamped>
     </Coordinate>
    </coordinates>
    <frames>
     <PhysicalOffsetFrame name="offset">
      <socket_parent>/bodyset/thigh</socket_parent><translation>0 -0.4 0</translation><orientation>0 0 0</orientation>
     </PhysicalOffsetFrame>
    </frames>
    <SpatialTransform>
     <TransformAxis name="rotation1"><coordinates>knee_angle</coordinates><axis>0 0 2</axis>
      <LinearFunction name="function"><coefficients>1 0</coefficients></LinearFunction></TransformAxis>
     <TransformAxis name="translation1"><coordinates>knee_angle</coordinates><axis>1 0 0</axis>
      <MultiplierFunction><function><PolynomialFunction><coefficients>0.01 0 0</coefficients></PolynomialFunction>
      </function><scale>3</scale></MultiplierFunction></TransformAxis>
    </SpatialTransform>
   </CustomJoint>
   <PinJoint name="hip">
    <socket_parent_frame>/ground</socket_parent_frame><socket_child_frame>thigh</socket_child_frame>
    <coordinates><Coordinate name="hip_angle"><range>-1 1</range></Coordinate></coordinates>
   </PinJoint>
   <SliderJoint name="cap_joint">
    <socket_parent_frame>/bodyset/thigh</socket_parent_frame><socket_child_frame>/bodyset/cap</socket_child_frame>
    <coordinates><Coordinate name="slide"/></coordinates>
   </SliderJoint>
  </objects></JointSet>
  <ConstraintSet name="constraintset"><objects>
   <CoordinateCouplerConstraint name="follow">
    <coupled_coordinates_function><LinearFunction><coefficients>0.1 0.02</coefficients></LinearFunction>
    </coupled_coordinates_function>
    <independent_coordinate_names>knee_angle</independent_coordinate_names>
    <dependent_coordinate_name>slide</dependent_coordinate_name>
   </CoordinateCouplerConstraint>
   <PointOnLineConstraint name="rail"/>
  </objects></ConstraintSet>
  <ForceSet name="forceset"><objects>
   <Thelen2003Muscle name="hamstring"><GeometryPath name="geometrypath"><PathPointSet><objects>
    <PathPoint name="a"><socket_parent_frame>/ground</socket_parent_frame><location>-0.05 0 0</location></PathPoint>
    <ConditionalPathPoint name="b"><socket_parent_frame>/bodyset/thigh</socket_parent_frame>
     <location>-0.06 -0.3 0</location><socket_coordinate>/jointset/knee/knee_angle</socket_coordinate>
     <range>-0.6 0.2</range></ConditionalPathPoint>
    <PathPoint name="c"><socket_parent_frame>/bodyset/shank</socket_parent_frame>
     <location>-0.04 -0.05 0</location></PathPoint>
   </objects></PathPointSet></GeometryPath></Thelen2003Muscle>
  </objects></ForceSet>
  <HuntCrossleyForce::ContactParametersSet name="x"><objects/></HuntCrossleyForce::ContactParametersSet>
 </Model>
</OpenSimDocument>
"""

WEDGE = """v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


@pytest.fixture(scope="session")
def osim_data():
    """Folder of the OpenSim models; the test is skipped where it is absent."""
    places = [os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"]
    for place in places:
        if place and (Path(place) / "osim").is_dir():
            return Path(place) / "osim"
    pytest.skip("the OpenSim models are not here (set RBFMUSCLE_DATA to the folder that holds osim/)")


@pytest.fixture
def small(tmp_path):
    """The small model with its mesh: a hip, a knee that rolls, a cap that follows the knee."""
    (tmp_path / "small.osim").write_text(SMALL)
    (tmp_path / "wedge.obj").write_text(WEDGE)
    return tmp_path / "small.osim"
