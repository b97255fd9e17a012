"""Chains of commands over settings, and the report that gathers what they answered."""
