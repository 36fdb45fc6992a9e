"""What a run would build."""
