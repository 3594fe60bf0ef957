"""Commissioning: what `stand check` looks at before anybody relies on a stand, and the record of it."""
