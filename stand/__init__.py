"""The daemon: hub, guard, run, recorder, sessions and the command line."""
