"""Fork server: a process that has imported everything and runs `g3r-infer` in forks of itself, to be killed.

It reads one request per line: {"arguments", "kill_after_s" (null: never), "signal", "file_bytes"}. It answers
with {"code" (negative: the signal that ended it), "output", "seconds"}. This process itself computes nothing,
because thread pools do not survive a fork.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import tempfile
import time

import g3r.cli.infer
import g3r.output.sections
import g3r.planning.memory_limit
import g3r.reconstruct


def run(request: dict) -> dict:
    with tempfile.TemporaryFile() as output:
        begun = time.monotonic()
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            code = 70
            try:
                if request.get("file_bytes"):
                    resource.setrlimit(resource.RLIMIT_FSIZE, (request["file_bytes"], resource.RLIM_INFINITY))
                code = g3r.cli.infer.main(request["arguments"])
            except SystemExit as end:
                code = int(end.code or 0)
            except KeyboardInterrupt:  # before the command handled signals
                code = 130
            finally:
                sys.stdout.flush()
                os._exit(code)
        if request.get("kill_after_s") is not None:
            time.sleep(max(0.0, begun + request["kill_after_s"] - time.monotonic()))
            os.kill(child, request.get("signal", signal.SIGKILL))
        _, status = os.waitpid(child, 0)
        output.seek(0)
        said = output.read().decode(errors="replace")
    return {"code": os.waitstatus_to_exitcode(status), "output": said, "seconds": time.monotonic() - begun}


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), file=answers, flush=True)
