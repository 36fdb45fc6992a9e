"""What is read from and written for OpenSim: models in, muscle paths out."""
