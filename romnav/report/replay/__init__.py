"""Episodes in 3D: in the browser and as videos."""
