"""Execute another program that the kernel ends when the parent of this one dies.

Run as a file, with the arguments PARENT_PID SIGNAL PROGRAM ARGUMENT...; the process id stays.
"""

import ctypes
import os
import sys

PR_SET_PDEATHSIG = 1


def bound(number: int, *program: str) -> list[str]:
    """Return the command of a program that gets a signal when the calling process dies.

    Args:
        number: of the signal.
        program: path and arguments.
    """
    return [sys.executable, '-I', '-S', __file__, str(os.getpid()), str(int(number)), *program]


if __name__ == '__main__':
    parent, number, *program = sys.argv[1:]
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(number))
    if os.getppid() != int(parent):
        sys.exit('the parent died first')
    os.execv(program[0], program)
