from streamtrack.__main__ import main

main()
