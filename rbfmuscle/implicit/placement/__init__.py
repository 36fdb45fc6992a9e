"""Where centres lie on a closed mesh."""
