"""Functional mock-up units against the observer in Python, by FMPy: the binary inside, and one compiled from the sources inside."""

import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from machines import drive, in_python, samples

from kros.core.errors import ConfigError
from kros.export import export_fmu
from kros.loops.compiler import find_compiler


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler is on the PATH")
@pytest.mark.parametrize(("fmi", "from_source", "track"), [(2, True, "phase"), (3, False, None)])
def test_two_instances_at_once_and_after_a_reset(fmi, from_source, track, tmp_path):
    fmpy = pytest.importorskip("fmpy", reason="FMPy (the extra fmu) is not installed")
    from fmpy import fmi2, fmi3
    from fmpy.build import build_platform_binary
    from fmpy.validation import validate_fmu

    units = {"units_of_measure": {"position": "rad", "velocity": "rad/s"}}
    observer, (y, u) = replace(drive(delay=0 if track else 2), about=units), samples(120, faults=False)
    path = export_fmu(observer, tmp_path / "drive.fmu", fmi, "drive", track=track)
    assert validate_fmu(str(path)) == []
    folder, model = fmpy.extract(str(path), tmp_path / "unpacked"), fmpy.read_model_description(str(path))
    if from_source:
        shutil.rmtree(tmp_path / "unpacked" / "binaries")
        (tmp_path / "build").mkdir()
        build_platform_binary(folder, tmp_path / "build")
    token, identifier = (model.guid if fmi == 2 else model.instantiationToken), model.coSimulation.modelIdentifier
    kind = fmi2.FMU2Slave if fmi == 2 else fmi3.FMU3Slave
    units = [
        kind(guid=token, unzipDirectory=folder, modelIdentifier=identifier, instanceName=name)
        for name in ("one", "two")
    ]
    references = {v.name: v.valueReference for v in model.modelVariables}
    seen, wanted = (
        [references[n] for n in ("position", "target", "rate")],
        [references[f"{s}_hat"] for s in observer.recorded],
    )
    for unit in units:
        unit.instantiate()
    for _ in range(2):
        for unit in units:
            if fmi == 2:
                unit.setupExperiment(startTime=0.0)
            set_values(unit, fmi, seen[:1], y[0])
            unit.enterInitializationMode(**({} if fmi == 2 else {"startTime": 0.0}))
            unit.exitInitializationMode()
        found = []
        for k in range(len(y)):
            for unit in units:
                set_values(unit, fmi, seen, [*y[k], *u[k]])
                unit.doStep(k * 1e-3, 1e-3)
            found.append([(unit.getReal if fmi == 2 else unit.getFloat64)(wanted) for unit in units])
        for estimates in np.swapaxes(found, 0, 1):
            np.testing.assert_allclose(estimates, in_python(observer, y, u, track)[0], rtol=1e-9, atol=1e-11)
        for unit in units:
            unit.reset()
    for unit in units:
        unit.terminate()
        unit.freeInstance()


def set_values(unit, fmi, references, values):
    (unit.setReal if fmi == 2 else unit.setFloat64)(references, list(values))


def test_the_same_observer_gives_the_same_bytes(tmp_path):
    one, two = (export_fmu(drive(), tmp_path / f"{name}.fmu", 3, "drive").read_bytes() for name in ("one", "two"))
    assert one == two
    assert "modelDescription.xml" in zipfile.ZipFile(tmp_path / "one.fmu").namelist()


@pytest.mark.parametrize(("out", "fmi"), [("drive.zip", 2), ("drive.fmu", 1)])
def test_what_is_no_fmu_is_refused(out, fmi, tmp_path):
    with pytest.raises(ConfigError):
        export_fmu(drive(), tmp_path / out, fmi)
    assert not list(tmp_path.iterdir())
