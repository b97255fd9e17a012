"""Before effects compete: do the series show what their labels say, and with which twin are they compared?"""
