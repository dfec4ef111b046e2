"""What the robot sees: LiDAR, its corruption, and the encoders."""
