//! What the executables share towards their user.
