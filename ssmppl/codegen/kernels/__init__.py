"""Runtime of the generated code: small compiled functions, one file per concern.

The functions are plain ``numba.njit`` dispatchers at module level, never cached on disk
themselves: the generated module that calls them is cached, and carries their text in its
digest.  Import the submodule wanted; nothing is compiled before its first call.
"""
