"""The daemon: hub, guard, scheduler, recorder, sessions and the command line."""
