"""Files that nobody vouches for: one line, bounded memory and time."""

import itertools
import string
import subprocess
import sys
import time

import pytest

from rbfmuscle.importers.opensim.elements import read_xml
from rbfmuscle.validation import SceneError

NESTED = "".join(
    f'<!ENTITY {b} "&{a};&{a};">' for a, b in itertools.pairwise(string.ascii_lowercase[:21])
)
LAUGHS = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "ha">{NESTED}'
UNKNOWN = '<?xml version="1.0" encoding="x-no"?><a/>'


def refuse(tmp_path, text):
    path = tmp_path / "bad.osim"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SceneError) as error:
        read_xml(path)
    message = str(error.value)
    assert "\n" not in message and str(path) in message
    return message


def test_entities_and_depth_are_refused_before_they_grow(tmp_path):
    start = time.process_time()
    assert "DOCTYPE" in refuse(tmp_path, LAUGHS + "]><x>&u;</x>")
    assert time.process_time() - start < 5.0
    assert "nested deeper" in refuse(tmp_path, "<a>" * 10_000 + "</a>" * 10_000)


def test_outside_entities_are_refused(tmp_path):
    (tmp_path / "secret").write_text("secret")
    text = f'<!DOCTYPE x [<!ENTITY s SYSTEM "file://{tmp_path}/secret">]><x>&s;</x>'
    assert "secret" not in refuse(tmp_path, text).replace(str(tmp_path), "")
    assert "DOCTYPE" in refuse(tmp_path, '<!DOCTYPE x SYSTEM "http://localhost/x.dtd"><x/>')


def test_a_gigabyte_from_a_pipe_is_refused_in_bounded_memory():
    code = (
        "import sys; from pathlib import Path; from rbfmuscle.importers.opensim.elements import "
        "read_xml\n"
        "from rbfmuscle.validation import SceneError\n"
        "try: read_xml(Path('/dev/stdin'))\n"
        "except SceneError as e: print(e)\n"
        "print([int(row.split()[1]) for row in open('/proc/self/status') if "
        "row.startswith('VmHWM')][0])"
    )
    feed = (
        "import sys\nb = b'<a>' + b'x' * (1 << 20)\nfor _ in range(1024): "
        "sys.stdout.buffer.write(b)"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", feed], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    words = [sys.executable, "-c", code]
    reader = subprocess.Popen(words, stdin=first.stdout, stdout=subprocess.PIPE, text=True)
    first.stdout.close()
    told = reader.stdout.read()
    reader.stdout.close()
    first.wait()
    assert reader.wait() == 0
    assert "more than 30 MB" in told
    # Of this child alone: what the system counts at its end includes the process that started it.
    assert int(told.split()[-1]) < 500_000  # [kB]


@pytest.mark.parametrize("text", ["", "no xml", "<a><b></a>", "<a", b"\xff\xfe<\x00", UNKNOWN])
def test_broken_files_are_one_line(tmp_path, text):
    refuse(tmp_path, text)


def test_two_colons_in_a_name_and_what_is_not_ascii_are_read(tmp_path):
    path = tmp_path / "good.osim"
    path.write_text('<A::B name="é"><!-- x::y --><c> 1 </c></A::B>', encoding="utf-8")
    root = read_xml(path)
    assert root.tag == "A__B" and root.get("name") == "é" and root.word("c") == "1"
