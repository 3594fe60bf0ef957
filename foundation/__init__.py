"""What every room speaks: errors, readings, items, time, YAML documents, files that appear whole."""
