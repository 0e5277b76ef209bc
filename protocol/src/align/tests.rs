//! Properties of the whole estimator on synthetic matches; the parts are tested beside it.
