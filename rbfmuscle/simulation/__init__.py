"""The frame loop: sub-steps, contact, tunnelling, sliding."""
