"""torch on demand behaves like torch, with the number of threads requested before its import."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import torch as real

from g3r.run.on_demand import is_tensor, torch


def after(code: str) -> str:
    """Output of a fresh interpreter."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.strip()


def test_it_is_torch() -> None:
    assert torch.zeros is real.zeros
    assert torch.nn.functional is real.nn.functional
    assert is_tensor(torch.zeros(1))
    assert not is_tensor(np.zeros(1))


def test_it_is_imported_when_something_of_it_is_used() -> None:
    first = "import sys\nfrom g3r.run.on_demand import is_tensor, torch\nassert not is_tensor(1)\n"
    assert after(first + "print('torch' in sys.modules)") == "False"
    assert after(first + "torch.zeros(1)\nprint('torch' in sys.modules)") == "True"


def test_threads_are_those_that_were_asked_for() -> None:
    code = "from g3r.run.on_demand import threads_of_torch, torch\nthreads_of_torch(3)\n"
    assert after(code + "print(torch.get_num_threads())") == "3"
    assert after(code + "torch.zeros(1)\nthreads_of_torch(1)\nprint(torch.get_num_threads())") == "1"
