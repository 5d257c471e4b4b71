"""NumPy to Arrow and back, against pyarrow's own conversion."""

import subprocess
import sys
from pathlib import Path


def test_reading_and_writing_leave_pandas_alone(tmp_path: Path) -> None:
    """Workers start without the half second that pandas costs."""
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv" / "a.csv").write_text("t,x\n0,1\n0.1,2\n0.2,4\n")
    code = """
import sys
from kros.data import read, write_parquet
table = {"files": "a", "time": "t", "channel": [{"name": "x", "column": "x", "role": "state"}]}
write_parquet(read(sys.argv[1] + "/csv", "csv", mapping=table), sys.argv[1] + "/out")
population = read(sys.argv[1] + "/out")
assert population.read(population.episodes[0]).ravel().tolist() == [1, 2, 4]
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, timeout=60)
