"""From predicted paths to the risk volume M: prediction in, risk out."""
