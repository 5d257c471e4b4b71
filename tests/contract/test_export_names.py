"""Hostile names in every slot of generated files: none is more than text."""

import re
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest
from machines import drive

from kros.core.errors import ConfigError
from kros.export import LoadOutput, export_c
from kros.export.c99.numbers import Source
from kros.export.fmu.write import fmu_files
from kros.export.text import plain, plain_names
from kros.lifting import Lifting
from kros.loops.compiler import find_compiler
from kros.motor_drive import AngleLoad

HOSTILE = {
    "comment": "x */ int EVIL(void) { return 0; } /*",
    "line": "x\n#error EVIL\n",
    "return": "x\r\x0b\x0c\x85\u2028#error EVIL\u2029",
    "backslash": "x EVIL \\",
    "trigraph": "x EVIL ??/",
    "control": "x\x00\x08\x1b[2J EVIL \x7f",
    "direction": "x \u202eEVIL\u2066\u200f\ufeff",
    "cmake": 'x ]=] ) execute_process(COMMAND touch EVIL) # ${EVIL} "',
    "markup": "x\"'><!-- EVIL ]]> & &#10; | `EVIL` <script>",
}


def named(text):
    """An observer with a hostile name in every slot, and the load that is exported with it."""
    names = [f"{slot} {text}" for slot in ("measured state", "hidden state", "input")]
    observer = drive(())
    about = {"units_of_measure": {names[0]: text}, "columns": {names[0]: {"offset": text}}}
    lifting, inputs = Lifting((names[0], "velocity", names[1])), (names[2], observer.inputs[1])
    observer = replace(observer, name=f"observer {text}", about=about, inputs=inputs, lifting=lifting)
    return observer, LoadOutput(AngleLoad(10.0, 1e-3), "velocity", names[1])


def without_comments(source):
    """C source as a compiler reads it, trigraphs and continued lines first."""
    source = source.replace("??/", "\\")
    source = re.sub(r"\\\s*\n", "", source)
    return re.sub(r"/\*.*?\*/|//[^\n]*", " ", source, flags=re.DOTALL)


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_name_is_text_in_every_file(kind, tmp_path):
    observer, load = named(HOSTILE[kind])
    folder = export_c(observer, tmp_path / "c", "drive", load=load)
    for file in folder.iterdir():
        text = file.read_bytes().decode()
        if file.suffix in (".c", ".h"):
            assert "EVIL" not in without_comments(text), file.name
        if file.suffix != ".json":
            assert not re.search(
                r"[\x00-\x08\x0b-\x1f\x7f\x85\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ufeff]", text
            ), file.name
        if file.name == "CMakeLists.txt":
            assert "EVIL" not in text
        if file.suffix == ".md":
            assert not re.search(r"<script|<!--|`EVIL`", text)
    if (compiler := find_compiler()) is not None:
        command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", *map(str, folder.glob("*.c"))]
        assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == ""
    files = fmu_files(Source.of(observer, "drive", "double"), 3, "guid")
    root = ET.fromstring(files["modelDescription.xml"])
    assert {child.tag for child in root} <= {
        "CoSimulation",
        "UnitDefinitions",
        "TypeDefinitions",
        "DefaultExperiment",
        "ModelVariables",
        "ModelStructure",
    }
    assert "EVIL" not in without_comments(files["sources/drive_fmu.c"])


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_identifier_is_refused(kind, tmp_path):
    with pytest.raises(ConfigError, match="C identifier"):
        export_c(drive(()), tmp_path / "c", HOSTILE[kind])
    observer = drive()
    object.__setattr__(observer.lifting, "parameters", (HOSTILE[kind],))
    with pytest.raises(ConfigError, match="C identifier"):
        export_c(observer, tmp_path / "c", "drive")
    assert not (tmp_path / "c").exists()


def test_names_that_would_be_one_text_are_refused():
    assert plain_names(["speed [rad/s]", "Drehzahl_ü"]) == ["speed [rad/s]", "Drehzahl_ü"]
    with pytest.raises(ConfigError, match="cannot be told apart"):
        plain_names(["a\\b", "a\nb"])


def test_the_comments_of_a_naive_export_would_have_been_found():
    assert "EVIL" in without_comments(f"/* {HOSTILE['comment']} */")
    assert "EVIL" not in without_comments(f"/* {plain(HOSTILE['comment'])} */")
