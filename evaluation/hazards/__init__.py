"""Does it see danger? Named and random traffic situations, what happens if nobody reacts, and which alarm says so."""
