//! Examples: one idea each. They are the files beside this one.
