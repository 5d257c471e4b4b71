"""What a stage is recorded to have written."""

import hashlib

from kros.study.engine.store import Store


def written(folder, told, afterwards=None):
    with Store(folder).drafting() as draft:
        path = draft.draft("a.txt")
        path.parent.mkdir(parents=True)
        path.write_text("one")
        draft.told(path, told)
        if afterwards is not None:
            path.write_text(afterwards)
        draft.commit("read", "key", 0.0)
    return Store(folder).record("read").files["a.txt"]


def test_a_digest_is_taken_from_who_wrote_a_file(tmp_path):
    assert written(tmp_path, "told") == "told"


def test_a_file_that_changed_since_is_read(tmp_path):
    assert written(tmp_path, "told", "other") == hashlib.sha256(b"other").hexdigest()


def test_recordings_are_recorded_with_the_digests_of_their_files(tmp_path):
    import kros

    motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    kros.run(motors, tmp_path / "run", until="read")
    record = Store(tmp_path / "run").record("read")
    assert sum(name.endswith(".parquet") for name in record.files) == 2
    for name, digest in record.files.items():
        assert hashlib.sha256((tmp_path / "run" / name).read_bytes()).hexdigest() == digest, name
