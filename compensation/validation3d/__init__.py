"""The paper's validation in three dimensions: how far the target seems to move when only the temperature did."""
