"""Parsing of the words after --slurm."""

from __future__ import annotations

import re

import pytest

from g3r.bids.slurm_request import MINUTES, parsed_request


def test_words_become_options_of_sbatch() -> None:
    found = parsed_request("partition=long, mem=4G,cpus_per_task=4,time=1-02:30,mail-type=FAIL")
    assert found.n_cores == 4
    assert found.minutes == 26 * 60 + 30
    assert dict(found.options) == {"partition": "long", "mem": "4G", "mail-type": "FAIL"}
    assert parsed_request("partition=long").minutes == MINUTES
    assert parsed_request("partition=long").n_cores is None


@pytest.mark.parametrize(
    ("text", "minutes"),
    [
        ("90", 90),
        ("90:30", 90),
        ("1:30:00", 90),
        ("0:30", 1),
        ("2-0", 2880),
        ("0-2", 120),
        ("1-12", 2160),
        ("1-12:30", 2190),
        ("1-12:30:00", 2190),
    ],
)
def test_slurms_ways_of_saying_a_time(text: str, minutes: int) -> None:
    assert parsed_request(f"time={text}").minutes == minutes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("long", "'long' in 'long'; expected partition=NAME"),
        ("partition=", "expected partition=NAME"),
        ("partition=a,array=1-9", "array=1-9 cannot be passed (--jobs says how many run at once)"),
        ("partition=a,ntasks_per_node=2", "a session is one task"),
        ("cpus_per_task=many", "expected a number of cores"),
        ("cpus_per_task=0", "expected a number of cores"),
        ("time=soon", "expected minutes"),
        ("time=0", "expected minutes"),
        ("time=0-0:00", "expected minutes"),
        ("time=1-", "expected minutes"),
        ("time=1:2:3:4", "expected minutes"),
    ],
)
def test_words_that_cannot_be(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        parsed_request(text)
