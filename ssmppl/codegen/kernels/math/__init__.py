"""Elementary and special functions, random numbers, and the compiler flags of all kernels."""
