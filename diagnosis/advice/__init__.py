"""What to measure next, and what a session could tell.

Files:
    plan           effects that a measurement set distinguishes, and which series to repeat
    plan_session   the same from a session
    next_series    measurements that a session lacks, simulated
"""
