"""Subspace-identified predictors: observers whose hidden states are identified from the past of what they see.

`moments` regresses the hidden states on the past in recordings and reduces this to a model of low order, `tuning` improves it on recordings,
`build` writes it into an observer, `limited` conditions it where hidden states meet limits, and `driven` runs the internal states along recordings.
"""
