"""What learned tables are compared with: codecs of images, and networks."""
