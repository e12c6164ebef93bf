"""Sessions of a BIDS data set: the stacks of one head, and their masks among the derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from g3r.bids.names import BidsName, parsed_name
from g3r.errors import InputError

READ_ENTITIES = {"sub", "ses", "acq", "run"}
"""A T2w file with others is no stack of slices as it was scanned: a reconstruction (rec), an echo, a phase image."""


@dataclass(frozen=True, kw_only=True)
class Session:
    """One visit of a participant, or all of a participant without sessions.

    Attributes:
        participant, session: labels; no session where the data set has none.
        stacks: T2w images of its anat folder, by name.
        left_out: names of T2w images that are no stacks.
    """

    participant: str
    session: str | None
    stacks: tuple[Path, ...]
    left_out: tuple[str, ...] = ()

    @property
    def stem(self) -> str:
        """How its files begin: sub-01_ses-02."""
        return f"sub-{self.participant}" + (f"_ses-{self.session}" if self.session else "")

    @property
    def folder(self) -> Path:
        """Where its files are in a data set."""
        return Path(*self.stem.split("_"))


def find_sessions(
    bids_dir: Path, participants: Sequence[str] | None = None, sessions: Sequence[str] | None = None
) -> list[Session]:
    """The sessions of a data set that have T2w images.

    Args:
        bids_dir: the data set.
        participants: labels, with `sub-` or without; None for all.
        sessions: labels, with `ses-` or without; None for all.

    Raises:
        InputError: no data set, a participant or session that is not in it, or no stack at all.
    """
    if not bids_dir.is_dir():
        raise InputError(f"{bids_dir}: is no folder; expected a BIDS data set, check the path")
    folders = _chosen(bids_dir, "sub", participants, f"{bids_dir}")
    if not folders:
        raise InputError(f"{bids_dir}: holds no folder sub-*; expected a BIDS data set, check the path")
    found = []
    for participant, folder in folders.items():
        visits = _labelled(folder, "ses")
        own = None if sessions else _session(folder, participant, None)
        found += [own] if own else []
        wanted = None if sessions is None else {_bare(label, "ses") for label in sessions}
        for label, visit in visits.items():
            if wanted is None or label in wanted:
                own = _session(visit, participant, label)
                found += [own] if own else []
    if not found:
        chosen = " for these participants and sessions" if participants or sessions else ""
        raise InputError(f"{bids_dir}: holds no T2w image{chosen}; expected sub-*/[ses-*/]anat/sub-*_T2w.nii.gz")
    return found


def find_masks(session: Session, bids_dir: Path, out_dir: Path, derivative: str | None = None) -> list[Path | None]:
    """The brain mask of each stack of a session; None where no derivative has one.

    Args:
        session: whose stacks.
        bids_dir: whose `derivatives/*/` are looked through.
        out_dir: passed by, since masks there were made from these stacks.
        derivative: name of the only folder of `derivatives/` to look in.

    Raises:
        InputError: two derivatives have masks of one stack.
    """
    root = bids_dir / "derivatives"
    masks: dict[frozenset[tuple[str, str]], dict[str, Path]] = {}
    if derivative is not None and not (root / derivative).is_dir():
        raise InputError(f"{root / derivative}: is no folder; pass --mask-derivative a name below derivatives/")
    for folder in sorted(root.iterdir()) if root.is_dir() else []:
        if not folder.is_dir() or folder.resolve() == out_dir.resolve() or derivative not in (None, folder.name):
            continue
        # plain _mask first, so that one with a description replaces it
        for path in sorted(
            (folder / session.folder).rglob("*_mask.nii*"), key=lambda path: ("_desc-" in path.name, path)
        ):
            name = parsed_name(path)
            if name is not None and _is_brain_mask(name):
                masks.setdefault(name.scan, {})[folder.name] = path
    found: list[Path | None] = []
    for stack in session.stacks:
        name = parsed_name(stack)
        own = masks.get(name.scan, {}) if name else {}
        if len(own) > 1:
            raise InputError(
                f"{stack.name}: has masks in derivatives/{' and derivatives/'.join(own)}; expected one, pass "
                f"--mask-derivative {next(iter(own))} or another"
            )
        found.append(next(iter(own.values()), None))
    return found


def _is_brain_mask(name: BidsName) -> bool:
    """Whether it is named in one of three ways: ..._desc-brain_mask, ..._T2w_desc-brain_mask, ..._run-1_mask."""
    return name.words in (("mask",), ("T2w", "mask")) and name.entities.get("desc", "brain") == "brain"


def _session(folder: Path, participant: str, session: str | None) -> Session | None:
    """The T2w images of an anat folder; None where it has none."""
    stacks, left_out = [], []
    for path in sorted((folder / "anat").glob("*_T2w.nii*")):
        name = parsed_name(path)
        is_own = name and name.words == ("T2w",) and name.entities.get("sub") == participant
        if name and is_own and name.entities.get("ses") == session and set(name.entities) <= READ_ENTITIES:
            stacks.append(path)
        else:
            left_out.append(path.name)
    if not stacks:
        return None
    return Session(participant=participant, session=session, stacks=tuple(stacks), left_out=tuple(left_out))


def _chosen(folder: Path, key: str, labels: Sequence[str] | None, where: str) -> dict[str, Path]:
    """Folders `key-LABEL`, all or those of some labels.

    Raises:
        InputError: a label without a folder.
    """
    found = _labelled(folder, key)
    if labels is None:
        return found
    wanted = [_bare(label, key) for label in labels]
    missing = [label for label in wanted if label not in found]
    if missing:
        there = f"{key}-{next(iter(found))} and {len(found) - 1} more" if found else f"no {key}-*"
        raise InputError(f"{where}: has no {key}-{missing[0]}; found {there}, check the label")
    return {label: found[label] for label in dict.fromkeys(wanted)}


def _labelled(folder: Path, key: str) -> dict[str, Path]:
    """Folders `key-LABEL` in order, by label."""
    paths = sorted(path for path in folder.glob(f"{key}-*") if path.is_dir())
    return {_bare(path.name, key): path for path in paths}


def _bare(label: str, key: str) -> str:
    return label.removeprefix(f"{key}-")
