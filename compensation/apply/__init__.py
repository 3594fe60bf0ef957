"""A drift model put to use: on points, on images, and in other people's programs."""
