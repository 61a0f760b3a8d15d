"""Outside the catalogue: a formula of few terms. Imports misfit, selection and below."""
