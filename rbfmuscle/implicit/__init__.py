"""The implicit surface: RBF fields, their centres and the surfaces extracted from them. No bones,
no time.
"""
