"""What a user edits: stands, recipes, register maps and targets; a package so that an installed wheel carries them."""
