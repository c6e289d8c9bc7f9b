"""Channel access for `orbitcal measure`: one JSON request a line on stdin, one reply a line on stdout.

    {"id": 1, "do": "describe", "channels": [NAME, ...], "timeout_s": 5}
    {"id": 2, "do": "read", "channels": [NAME, ...], "timeout_s": 5}
    {"id": 3, "do": "write", "channels": [NAME], "value": 22.0, "timeout_s": 5}

It knows nothing of the machine, and ends with its input.
"""

import asyncio
import json
import math
import sys

import aioca

INVALID = 3  # alarm severity
SILENT_S = 2.0  # a channel that gives no value for so long is told as silent; the caller decides how long to go on

WRITE_S = 5.0  # for a write to be processed


def numbers(value):
    """The numbers of a value; None for what is no number."""
    try:
        several = [float(one) for one in value] if hasattr(value, "__len__") else [float(value)]
    except (TypeError, ValueError):
        return [None]
    return [one if math.isfinite(one) else None for one in several]


async def describe(request):
    names, timeout = request["channels"], min(request["timeout_s"], 5.0)
    infos = await aioca.connect(names, timeout=timeout, throw=False)
    there = [name for name, info in zip(names, infos) if info.ok]
    known = dict(zip(there, await asyncio.gather(*(channel(name, timeout) for name in there))))
    nothing = {"connected": False, "readable": False, "writable": False, "count": 0, "limits": None}
    return {"channels": [known.get(name, nothing) for name in names]}


async def channel(name, timeout):
    info = await aioca.cainfo(name, timeout=timeout)
    value = await aioca.caget(name, format=aioca.FORMAT_CTRL, timeout=timeout, throw=False)
    low, high = getattr(value, "lower_ctrl_limit", 0.0), getattr(value, "upper_ctrl_limit", 0.0)
    return {
        "connected": True,
        "readable": bool(info.read) and value.ok,
        "writable": bool(info.write),
        "count": info.count,
        "limits": [low, high] if low < high else None,  # records without limits state 0 and 0
    }


async def read(request):
    timeout = min(request["timeout_s"], SILENT_S)
    values = await aioca.caget(request["channels"], format=aioca.FORMAT_TIME, timeout=timeout, throw=False)
    return {"samples": [sample(value) for value in values]}


def sample(value):
    if not value.ok:
        return {"error": why(value)}
    taken = {"value": numbers(value), "time_s": value.timestamp, "invalid": value.severity >= INVALID}
    return {"sample": taken}


def why(failed):
    """What the library says, without the name of the channel."""
    return str(failed).removeprefix(f"{failed.name}: ")


async def write(request):
    [name] = request["channels"]
    done = await aioca.caput(name, request["value"], wait=True, timeout=min(request["timeout_s"], WRITE_S), throw=False)
    return {} if done.ok else {"error": why(done)}


DO = {"describe": describe, "read": read, "write": write}


async def serve():
    loop = asyncio.get_running_loop()
    while line := await loop.run_in_executor(None, sys.stdin.readline):
        request = json.loads(line)
        reply = await DO[request["do"]](request)
        print(json.dumps({"id": request["id"], **reply}), flush=True)


def main():
    asyncio.run(serve())
