"""Execute another program that the kernel ends when the parent of this one dies.

Run as a file, with the arguments PARENT_PID SIGNAL PROGRAM ARGUMENT...; the process id stays.
"""

import ctypes
import os
import sys

PR_SET_PDEATHSIG = 1

if __name__ == '__main__':
    parent, number, *program = sys.argv[1:]
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(number))
    if os.getppid() != int(parent):
        sys.exit('the parent died first')
    os.execv(program[0], program)
