"""After the drive: what a recording tells, read back without bus or services."""
