"""Functions of arrays for every package: triangles, nearest points, weights, rotations."""
