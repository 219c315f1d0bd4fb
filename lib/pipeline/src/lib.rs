//! Configuration, artifacts and stages, whatever the stages compute.
