//! The executables as a user runs them: on files, by exit code and by what they print.
mod bad_input;
mod disk;
mod guidance;
mod inspection;
mod interruption;
mod kills;
mod large;
mod manual;
mod page;
mod pipeline;
mod project;
mod recovery;
mod reproducibility;
mod stages;
mod staleness;
mod usage;
mod whole;
