"""`g3r-pretrain` when it is interrupted or runs out of memory, whichever library raises the error."""

from __future__ import annotations

import sys

import pytest

pytest.importorskip("lightning.pytorch", reason="the training extra is not installed")

from g3r.cli.pretrain import main


def left_by_lightning() -> None:
    """An interrupted fit: Lightning ends the process itself."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        sys.exit(1)


def wrapped_by_jsonargparse() -> None:
    """A data module that could not be made."""
    try:
        raise MemoryError
    except MemoryError as error:
        raise ValueError("Parser key 'data'") from error


def of_a_graphics_card() -> None:
    raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")


def pressed() -> None:
    raise KeyboardInterrupt


def exhausted() -> None:
    raise MemoryError


FAILURES = [
    (pressed, 130, "interrupted"),
    (left_by_lightning, 130, "interrupted"),
    (exhausted, 4, "out of memory"),
    (wrapped_by_jsonargparse, 4, "out of memory"),
    (of_a_graphics_card, 4, "out of memory"),
]


def failing_with(monkeypatch: pytest.MonkeyPatch, failure: object) -> None:
    monkeypatch.setattr("lightning.pytorch.cli.LightningCLI.__init__", failure)


@pytest.mark.parametrize(("failure", "code", "says"), FAILURES, ids=[one[0].__name__ for one in FAILURES])
def test_ctrl_c_and_little_memory_end_in_one_line(
    failure: object, code: int, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(failure)
    failing_with(monkeypatch, lambda *arguments, **options: failure())
    assert main(["fit"]) == code
    said = capsys.readouterr().err
    assert said.startswith(f"g3r-pretrain: {says}")
    assert said.count("\n") == 1


def test_defects_and_usage_errors_stay_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    def defect(*arguments: object, **options: object) -> None:
        raise ValueError("shapes do not match")

    failing_with(monkeypatch, defect)
    with pytest.raises(ValueError, match="shapes do not match"):
        main(["fit"])
    failing_with(monkeypatch, lambda *arguments, **options: sys.exit(2))
    with pytest.raises(SystemExit, match="2"):
        main(["fit"])
