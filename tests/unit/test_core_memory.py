"""Memory that is freed and asked for again."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from kros.core.memory import keep_freed_memory
{}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        arrays = [np.ones(500_000) for _ in range(5)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


def faults(first: str) -> int:
    return int(subprocess.run([sys.executable, "-c", FAULTS.format(first)], check=True, capture_output=True, text=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep memory as they like")
def test_freed_memory_is_used_again_without_asking_for_every_page():
    asked, kept = faults(""), faults("keep_freed_memory()")
    if asked < 20_000:  # 250 arrays of a thousand pages
        pytest.skip("pages are large here")
    assert kept < asked / 20


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep memory as they like")
def test_a_process_that_imports_kros_and_runs_work_in_itself_stays_as_it_is():
    """Only the command line and workers are kros's own; in a notebook other code lives, too."""
    own = "import kros.cli\nfrom kros.study.engine.executors import open_executor\nwith open_executor(1) as executor:\n    list(executor.map(abs, [1]))"
    asked, after = faults(""), faults(own)
    if asked < 20_000:
        pytest.skip("pages are large here")
    assert after > asked / 2
