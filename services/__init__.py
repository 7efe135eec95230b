"""The three services; each imports only `common`, never another service."""
