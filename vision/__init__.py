"""What robot and server see alike: features of an image, and the lens in front of it."""
