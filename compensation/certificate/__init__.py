"""A calibration certificate of a camera's thermal drift: the order, the certified values, and the stand's part."""
