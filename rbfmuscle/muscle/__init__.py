"""The RBF muscle."""
