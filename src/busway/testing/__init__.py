"""What tests need: lines, faults, fakes. Public, for the tests of programs that use the library too."""
