"""From the risk volume to a path and a speed: risk in, plan out."""
