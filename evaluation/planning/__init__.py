"""How well the planner drives: closed loop in simulated time, measured from the world."""
