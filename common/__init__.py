"""What every service shares: the contract on the bus, the loop, the equations."""
