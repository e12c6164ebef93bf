"""What a file of torch.save must look like before anything in it is read: plain storage, known names.

A checkpoint comes from somebody else. `torch.load(weights_only=True)` runs nothing, but it takes the memory
that a file asks for, and its own list of what may be called is longer than what our files need.
"""

from __future__ import annotations

import pickletools
import re
import zipfile
from pathlib import Path

from g3r.errors import InputError

MAX_PICKLE_BYTES = 4_000_000
"""Ours have about 20 kB: names and sizes, the numbers stand beside."""

CALLED = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict"
    r"|torch (Float|Double|Half|BFloat16|Long|Int|Short|Char|Byte|Bool)Storage"
)
"""All that a file of tensors and plain values names."""


def check_archive(path: Path, kind: str, another_file: str) -> None:
    """Refuse what is no file of torch.save that holds tensors and plain values only; nothing is unpickled.

    Args:
        path: of the file.
        kind: what it should be, for the message: "prior".
        another_file: what to do when it is something else.

    Raises:
        InputError: no such file, no archive, a damaged or compressed one, or one that names other things.
    """
    try:
        with path.open("rb") as stream:
            is_zip = stream.read(4) == b"PK\x03\x04"
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a {kind} checkpoint; {another_file}") from None
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({found}); {another_file}") from None
    if not is_zip:
        raise InputError(f"{path}: is not a {kind} checkpoint (not a file of torch.save); {another_file}")
    damaged = f"{path}: is damaged or not written by g3r-export; {another_file}"
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            pickled = [one for one in entries if one.filename.endswith("data.pkl")]
            # stored as they are, and each once: no small file unfolds to a large one
            plain = all(one.compress_type == zipfile.ZIP_STORED for one in entries)
            plain &= sum(one.file_size for one in entries) <= path.stat().st_size
            if not plain or len(pickled) != 1 or pickled[0].file_size > MAX_PICKLE_BYTES:
                raise InputError(damaged)
            foreign = _foreign_name(archive.read(pickled[0]))
    except InputError:
        raise
    except Exception:  # zipfile and pickletools raise what damaged bytes make them raise
        raise InputError(damaged) from None
    if foreign is not None:
        raise InputError(f"{damaged.replace(';', f' (it names {foreign[:60]!r});', 1)}")


def _foreign_name(pickled: bytes) -> str | None:
    """The first thing a pickle would import that is not ours to need; None where there is none."""
    for opcode, argument, _ in pickletools.genops(pickled):
        if opcode.name == "GLOBAL" and not CALLED.fullmatch(str(argument)):
            return str(argument)
        if opcode.name in ("STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"):
            return opcode.name
    return None
