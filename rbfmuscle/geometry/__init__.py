"""Arithmetic on arrays that every room may use: triangles, nearest points, weights, frames. A leaf."""
