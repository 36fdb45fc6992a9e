"""The frame loop: sub-steps, contact, tunnelling, neighbours."""
