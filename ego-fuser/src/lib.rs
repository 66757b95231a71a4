//! ego-fuser
