"""What a camera has been through: recorded temperatures, their lags, thermal states."""
