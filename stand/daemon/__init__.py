"""The daemon: a stand that is open for days, its queue, its own record, and what is done by hand between runs."""
