"""File formats: what meshio gets wrong or loses, put right around it."""
