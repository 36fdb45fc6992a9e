"""Any muscle against bones: scene, motion, distance fields, contact and the frame loop. Knows no model."""
