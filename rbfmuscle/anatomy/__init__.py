"""What names and shapes of bones say of a body."""
