"""Checks that a test starts in a process of their own: each prints a line of JSON, its name, and what was wrong, or null."""

import json
import traceback

CHECKS = {}


def check(fn):
    CHECKS[fn.__name__] = fn
    return fn


def main(names):
    for name in names or CHECKS:
        wrong = None
        try:
            CHECKS[name]()
        except Exception:
            wrong = traceback.format_exc()
        print(json.dumps({"name": name, "wrong": wrong}), flush=True)
