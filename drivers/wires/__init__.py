"""Wires and their codecs: Modbus, XIMC, GigE Vision; bytes and messages, nothing of what they mean to a stand."""
