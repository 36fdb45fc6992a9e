"""Self-collision of mesh muscles."""
