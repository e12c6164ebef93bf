"""Stand-in for g3r-infer: copies a prepared result after some time and records when it ran."""

import json
import shutil
import sys
import time
from pathlib import Path

result, events, seconds = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])
words = sys.argv[4:]
output = Path(words[words.index("--output") + 1])
stack = Path(words[words.index("--stacks") + 1])
note = events / f"{stack.name}.{time.time_ns()}.json"
note.write_text(json.dumps({"words": words, "began": time.time(), "ended": None}))
if stack.read_bytes().startswith(b"broken"):
    print(f"g3r-infer: {stack.name}: not a readable NIfTI file (it is broken); copy or export it again")
    raise SystemExit(3)
if stack.read_bytes().startswith(b"endless"):
    seconds = 600
if stack.read_bytes().startswith(b"hungry"):
    held = bytearray(600_000_000)
    held[::4096] = b"x" * len(held[::4096])  # the system allocates only pages that are written
    seconds = 600
time.sleep(seconds)
staging = output.with_name("unfinished")  # appears atomically, as with g3r-infer
shutil.copytree(result, staging, dirs_exist_ok=True)
shutil.rmtree(output, ignore_errors=True)
staging.rename(output)
note.write_text(json.dumps({**json.loads(note.read_text()), "ended": time.time()}))
