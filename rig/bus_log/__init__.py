"""The bus recorded, replayed and repeated: raw messages with their headers, in MCAP files."""
