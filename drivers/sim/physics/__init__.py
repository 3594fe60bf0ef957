"""What is true in the simulated laboratory: heat, the camera's drift, and the image that follows."""
