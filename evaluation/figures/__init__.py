"""The paper's figures of the field, redrawn from our own: `forefield figures --out DIR`."""
