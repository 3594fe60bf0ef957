"""The HTTP interface of a stand: a thread of its own, apart from the control loop."""
