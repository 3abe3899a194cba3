from streamtrack.cli import main

main()
