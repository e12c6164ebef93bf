"""Memory: stated before it is taken, planned to stay below a limit."""

from g3r.memory.allocator import give_back
from g3r.memory.estimate import MemoryEstimate, estimate_memory, peak_bytes
from g3r.memory.plan import MemoryPlan, plan_for_stacks, plan_memory
from g3r.memory.size import gigabytes, parsed_size

__all__ = [
    "MemoryEstimate",
    "MemoryPlan",
    "estimate_memory",
    "gigabytes",
    "give_back",
    "parsed_size",
    "peak_bytes",
    "plan_for_stacks",
    "plan_memory",
]
