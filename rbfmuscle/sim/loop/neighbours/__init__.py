"""How a muscle sees its neighbours: where they will be, and what holds it to them."""
