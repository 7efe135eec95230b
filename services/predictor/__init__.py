"""From traffic histories to predicted paths: objects in, prediction out."""
