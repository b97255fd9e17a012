"""Numbers of a twin at a setting: flatfield, dose, contrast; of one setting or many."""
