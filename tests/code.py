"""`python -m tests.code CODE ARGUMENT ...` is as `python -c CODE ARGUMENT ...`, and may be forked: see
tests/fork_server.py."""

import sys


def main() -> None:
    code = sys.argv.pop(1)
    exec(compile(code, "<code of a test>", "exec"), {"__name__": "__main__"})


if __name__ == "__main__":
    main()
