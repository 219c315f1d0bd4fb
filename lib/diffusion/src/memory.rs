//! What becomes of memory that networks free.

/// Has the C library keep memory that is freed instead of giving it back.
///
/// A network's results are a few megabytes each, are freed soon after and are
/// asked for again; glibc returns such pieces to the system, which then fills
/// every page with zeros anew. Affects the whole process, so executables call
/// it, once and early. The process keeps up to 2 GiB beyond what is in use.
/// Does nothing where there is no glibc.
pub fn keep_freed() {
    /// The most that glibc before 2.35 takes as threshold. It refuses more; any other call then fixes the threshold at
    /// its start, 128 KiB, and nearly all pieces would be given back.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    const MOST_OF_OLDER: i32 = 32 << 20;
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `mallopt` takes plain numbers and locks what it changes.
    unsafe {
        if libc::mallopt(libc::M_MMAP_THRESHOLD, i32::MAX) == 0 {
            libc::mallopt(libc::M_MMAP_THRESHOLD, MOST_OF_OLDER);
        }
        libc::mallopt(libc::M_TRIM_THRESHOLD, i32::MAX);
    }
}
