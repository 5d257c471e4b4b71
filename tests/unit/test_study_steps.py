"""What a change of the study makes again."""

from collections.abc import Callable
from pathlib import Path

import pytest

from kros.core.work import Work
from kros.report.manifest import Artefact
from kros.study.config import Stage, StudyConfig, validate_config
from kros.study.engine.context import Context, StageStep, run_steps
from kros.study.engine.store import Store
from kros.study.pipeline import STEPS


def test_every_section_of_a_study_belongs_to_a_stage():
    sections = [name.partition(".")[0] for step in STEPS for name in step.sections]
    assert set(sections) == set(StudyConfig.model_fields)
    assert [step.stage for step in STEPS] == list(Stage)


def study(**identify) -> StudyConfig:
    return validate_config({"data": {"source": "."}, "identify": identify}, Path(__file__).parent / "nothing")


def writing(stage: Stage, computed: list[str]) -> Callable[[Context], None]:
    """A stage that writes what it followed from."""

    def run(context: Context) -> None:
        computed.append(stage)
        text = str(context.config.identify.alpha)
        if stage is not Stage.IDENTIFY:
            text += context.store.path("identify.txt").read_text()
        context.store.draft().mkdir()
        context.store.draft(f"{stage}.txt").write_text(text)

    return run


def steps(config: StudyConfig, folder: Path, computed: list[str]) -> Store:
    """Run two stages."""

    sections = {Stage.IDENTIFY: ("identify",), Stage.QUANTIFY: ("uncertainty",)}
    order = tuple(StageStep(stage, writing(stage, computed), names) for stage, names in sections.items())
    run_steps(Context(config, Store(folder), Work()), order, Stage.QUANTIFY)
    return Store(folder)


def test_what_is_in_the_store_comes_back_with_all_that_follows_from_it(tmp_path):
    computed: list[str] = []
    for alpha in (1.0, 90.0, 1.0, 90.0):
        store = steps(study(alpha=alpha), tmp_path, computed)
        assert (tmp_path / "quantify.txt").read_text() == 2 * str(alpha)
        store.verify()
    assert computed == ["identify", "quantify"] * 2


def test_artefacts_of_different_settings_are_never_named_together(tmp_path, monkeypatch):
    for alpha in (1.0, 90.0):
        steps(study(alpha=alpha), tmp_path, [])
    whole, add = Store(tmp_path).manifest, Store.add

    def killed(self: Store, stage: str, artefact: Artefact) -> None:
        if stage == Stage.QUANTIFY:
            raise KeyboardInterrupt
        add(self, stage, artefact)

    monkeypatch.setattr(Store, "add", killed)
    with pytest.raises(KeyboardInterrupt):
        steps(study(alpha=1.0), tmp_path, [])
    assert Store(tmp_path).manifest["identify"] != whole["identify"]
    assert "quantify" not in Store(tmp_path).manifest
    assert not (tmp_path / "quantify.txt").exists()
