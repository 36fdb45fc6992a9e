"""What a scene will build, reach and cost, found without building it."""
