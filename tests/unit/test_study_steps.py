"""What a change of the study makes again."""

from kros.study.config import Stage, StudyConfig
from kros.study.pipeline import STEPS


def test_every_section_of_a_study_belongs_to_a_stage():
    sections = [name.partition(".")[0] for step in STEPS for name in step.sections]
    assert set(sections) == set(StudyConfig.model_fields)
    assert [step.stage for step in STEPS] == list(Stage)
