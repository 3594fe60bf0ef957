"""What every package uses: errors, readings, items, time, YAML documents, files that appear whole."""
