"""What a camera's datasheet says of its behaviour over temperature, each number with its uncertainty."""
