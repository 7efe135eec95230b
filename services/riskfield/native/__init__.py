"""The kernels' C++: snippets that Warp compiles for the CPU and for CUDA from the same text.

Rules that keep them fast: objects are the outer loop and cells the inner one, in whole vectors of W cells over a local
accumulator; what depends only on the row is taken out of the loop over cells; nothing in it branches.
"""
