"""The measured session: its series, what their frames say in one pass, which of them can be compared."""
