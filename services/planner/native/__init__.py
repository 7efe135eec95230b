"""The planner's hot loops in C++, and the structures by which they get their arguments; `kernels.py` launches them."""
