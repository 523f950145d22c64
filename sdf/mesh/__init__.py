"""Triangle meshes: repair, inside and outside, signed distances, symmetry, resting poses."""
