//! The executables as a user runs them: on files, by exit code and by what they print.
mod bad_input;
mod inspection;
mod interruption;
mod large;
mod project;
mod recovery;
mod reproducibility;
mod stages;
mod usage;
