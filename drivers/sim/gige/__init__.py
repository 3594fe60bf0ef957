"""The simulated GigE Vision camera: its protocols, features and registers, and the switch its packets cross."""
