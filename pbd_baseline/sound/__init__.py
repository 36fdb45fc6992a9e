"""What keeps a mesh muscle sound: out of bones with its held ends and between its vertices, and not through itself."""
