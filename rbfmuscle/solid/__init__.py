"""The elastic solid that carries an RBF muscle: lattice, energy, contact, equilibrium."""
