"""The thermal imager, a folder of radiometric JPEGs."""
