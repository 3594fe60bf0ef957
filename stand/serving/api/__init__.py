"""The HTTP interface of a stand: a thread of its own beside the control loop."""
