"""The estimator: a linear regression of all states on a bank of fixed stable filters.

measurements, inputs --channels--> signals --filters--> bank --ridge regression--> estimate --reduction--> observer

Examples
--------
>>> from kros.observer import EstimatorSettings
>>> EstimatorSettings(first_lag=500.0).lags(6000)
(300.0, 600.0)
"""
