"""The belief over the object's pose and how it follows readings."""
