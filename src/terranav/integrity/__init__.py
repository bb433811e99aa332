"""Is this fix to be believed: consistency tests, protection level, recovery."""
