"""Sessions of a BIDS data set: the stacks of one head, and their masks among the derivatives."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from g3r.bids.description import is_own_derivative
from g3r.bids.names import BidsName, parsed_name
from g3r.errors import InputError
from g3r.run.folder_walk import walked

READ_ENTITIES = {"sub", "ses", "acq", "run"}
"""Entities of a scanned stack. A T2w file with others is a reconstruction (rec), an echo or a phase image."""


@dataclass(frozen=True, kw_only=True)
class Session:
    """One visit of a participant, or all of a participant without sessions.

    Attributes:
        participant, session: labels; session is None if the data set has none.
        stacks: T2w images of its anat folder, in order of their names.
        left_out: names of T2w images that are not stacks; where there is no other, the session is passed over.
    """

    participant: str
    session: str | None
    stacks: tuple[Path, ...]
    left_out: tuple[str, ...] = ()

    @property
    def stem(self) -> str:
        """Beginning of its file names, such as sub-01_ses-02."""
        return f"sub-{self.participant}" + (f"_ses-{self.session}" if self.session else "")

    @property
    def folder(self) -> Path:
        """Its folder, relative to the data set."""
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
        InputError: there is no data set, it lacks a participant or session, or it has no stack.
    """
    if not bids_dir.is_dir():
        raise InputError(f"{bids_dir}: is no folder; expected a BIDS data set, check the path")
    folders = _chosen(bids_dir, "sub", participants, f"{bids_dir}")
    if not folders:
        raise InputError(f"{bids_dir}: holds no folder sub-*; expected a BIDS data set, check the path")
    wanted = None if sessions is None else [_bare(label, "ses") for label in sessions]
    visits = {participant: _labelled(folder, "ses") for participant, folder in folders.items()}
    _check_labels(wanted or [], [label for own in visits.values() for label in own], "ses", f"{bids_dir}")
    found = []
    for participant, folder in folders.items():
        own = None if sessions else _session(folder, participant, None)
        found += [own] if own else []
        for label, visit in visits[participant].items():
            if wanted is None or label in wanted:
                own = _session(visit, participant, label)
                found += [own] if own else []
    if not any(session.stacks for session in found):
        chosen = " for these participants and sessions" if participants or sessions else ""
        raise InputError(f"{bids_dir}: holds no T2w image{chosen}; expected sub-*/[ses-*/]anat/sub-*_T2w.nii.gz")
    return found


def find_masks(session: Session, bids_dir: Path, out_dir: Path, derivative: str | None = None) -> list[Path | None]:
    """The brain mask of each stack of a session; None if no derivative has one.

    Masks found by g3r are not the user's own, so derivative data sets that it made are skipped unless they are named.

    Args:
        session: the session of the stacks.
        bids_dir: the data set; its `derivatives/*/` are searched.
        out_dir: skipped, because masks there were made from these stacks.
        derivative: name of the only folder of `derivatives/` to search.

    Raises:
        InputError: one stack has two masks, or the named folder cannot be searched.
    """
    root = bids_dir / "derivatives"
    masks: dict[frozenset[tuple[str, str]], list[Path]] = {}
    for folder in _mask_folders(root, out_dir, derivative):
        for path in (parent / name for parent, names in walked(folder / session.folder) for name in names):
            if not fnmatch(path.name, "*_mask.nii*"):
                continue
            name = parsed_name(path)
            if name is not None and _is_brain_mask(name):
                masks.setdefault(name.scan, []).append(path.relative_to(root))
    found: list[Path | None] = []
    for stack in session.stacks:
        name = parsed_name(stack)
        own = masks.get(name.scan, []) if name else []
        if len(own) > 1:
            raise _several_masks(stack, own)
        found.append(root / own[0] if own else None)
    return found


def _mask_folders(root: Path, out_dir: Path, derivative: str | None) -> list[Path]:
    """The folders below `derivatives/` whose masks are the user's own; see `find_masks`."""
    if derivative is None:
        folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
        return [path for path in folders if not (_is_same(path, out_dir) or is_own_derivative(path))]
    folder = root / derivative
    if folder.parent != root or derivative == ".." or not folder.is_dir():
        raise InputError(f"{folder}: is no folder; pass --mask-derivative a name below derivatives/")
    if _is_same(folder, out_dir):
        raise InputError(f"{folder}: is OUT_DIR, too, where masks are replaced; copy those to keep to another folder")
    return [folder]


def _is_same(folder: Path, other: Path) -> bool:
    """Whether two paths are the same folder, by any link or spelling."""
    return other.exists() and folder.samefile(other)


def _several_masks(stack: Path, masks: list[Path]) -> InputError:
    """The error for a stack with several masks, with the remedy that fits."""
    folders = list(dict.fromkeys(path.parts[0] for path in masks))
    if len(folders) > 1:
        named = " and ".join(f"derivatives/{folder}" for folder in folders)
        return InputError(
            f"{stack.name}: has masks in {named}; expected one, pass --mask-derivative {folders[0]} or another"
        )
    named = " and ".join(f"derivatives/{path.as_posix()}" for path in masks)
    return InputError(
        f"{stack.name}: has masks {named}; expected one, remove the others or pass --mask-derivative another folder"
    )


def _is_brain_mask(name: BidsName) -> bool:
    """Whether it is a brain mask by its name: ..._desc-brain_mask, ..._T2w_desc-brain_mask, ..._run-1_mask."""
    return name.words in (("mask",), ("T2w", "mask")) and name.entities.get("desc", "brain") == "brain"


def _session(folder: Path, participant: str, session: str | None) -> Session | None:
    """The session of an anat folder; None if the folder has no T2w images."""
    stacks, left_out = [], []
    for path in sorted((folder / "anat").glob("*_T2w.nii*")):
        name = parsed_name(path)
        is_own = name and name.words == ("T2w",) and name.entities.get("sub") == participant
        if name and is_own and name.entities.get("ses") == session and set(name.entities) <= READ_ENTITIES:
            stacks.append(path)
        else:
            left_out.append(path.name)
    if not (stacks or left_out):
        return None
    return Session(participant=participant, session=session, stacks=tuple(stacks), left_out=tuple(left_out))


def _chosen(folder: Path, key: str, labels: Sequence[str] | None, where: str) -> dict[str, Path]:
    """Folders `key-LABEL` by label: all, or those of the given labels.

    Raises:
        InputError: a label has no folder.
    """
    found = _labelled(folder, key)
    if labels is None:
        return found
    wanted = [_bare(label, key) for label in labels]
    _check_labels(wanted, found, key, where)
    return {label: found[label] for label in dict.fromkeys(wanted)}


def _check_labels(wanted: Sequence[str], found: Collection[str], key: str, where: str) -> None:
    """Refuse labels that were not found.

    Raises:
        InputError: see above.
    """
    missing = [label for label in wanted if label not in found]
    if missing:
        n_more = len(set(found)) - 1
        there = f"{key}-{next(iter(found))} and {n_more} more" if found else f"no {key}-*"
        raise InputError(f"{where}: has no {key}-{missing[0]}; found {there}, check the label")


def _labelled(folder: Path, key: str) -> dict[str, Path]:
    """Folders `key-LABEL` in order of their names, by label."""
    paths = sorted(path for path in folder.glob(f"{key}-*") if path.is_dir())
    return {_bare(path.name, key): path for path in paths}


def _bare(label: str, key: str) -> str:
    return label.removeprefix(f"{key}-")
