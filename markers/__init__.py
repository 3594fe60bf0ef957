"""Images -> identified marker centres."""
