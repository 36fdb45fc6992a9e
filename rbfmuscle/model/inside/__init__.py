"""The inside of an RBF muscle: an elastic, incompressible solid on a lattice that carries the centres."""
