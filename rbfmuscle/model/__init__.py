"""The RBF muscle: joins a field to the simulation."""
