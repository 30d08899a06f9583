"""What a camera sees of a mesh: how much of the texture a pixel covers, and which photos see a point."""
