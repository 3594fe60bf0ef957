"""The figures of reports, one function each: numbers in, matplotlib figures out."""
