/* What every compiled pipe tool has in common: how it leaves a line to Python, and how it talks to the daemon.
 *
 * A tool stands after this text (devin.c), and what both take from the tools in Python stands before it; which is put
 * together by sioms.tools.compiled. Why so: docs/decisions/0285.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { MOST_DEPTH = 16, FIRST_WORD = 8, PATIENCE_US = 100000, MOST_NAME = 200 };

static char **arguments;
static void (*committed)(void); /* what to do instead, where it is too late to become another program */

/* Become the tool in Python. Every descriptor of ours is closed by that. */
static _Noreturn void leave_to_python(void)
{
    if (committed)
        committed();
    execvp(arguments[1], arguments + 1);
    _exit(127);
}

static void *take(size_t size)
{
    void *memory = calloc(1, size);
    if (!memory)
        leave_to_python();
    return memory;
}

/* Say one line, its blanks made single. */
static void say(const char *text)
{
    static char line[8 * MAX_PACKET];
    size_t n = sizeof TOOL;
    memcpy(line, TOOL ":", n);
    for (const char *c = text; *c && n < sizeof line - 2; c++) {
        if (*c != ' ' && (c == text || c[-1] == ' '))
            line[n++] = ' ';
        if (*c != ' ')
            line[n++] = *c;
    }
    line[n++] = '\n';
    if (write(2, line, n) < 0)
        return; /* nobody listens there; the status still tells */
}

static _Noreturn void fail(const char *text)
{
    say(text);
    _exit(1);
}

/* Take one character of UTF-8; what is none gives U+FFFD for as much of it as could have begun one. */
static uint32_t take_character(const uint8_t **at)
{
    uint32_t first = *(*at)++, value = first < 0xE0 ? first & 31 : first < 0xF0 ? first & 15 : first & 7;
    int more = first < 0xE0 ? 1 : first < 0xF0 ? 2 : 3;
    if (first < 0x80)
        return first;
    if (first < 0xC2 || first > 0xF4)
        return 0xFFFD;
    uint8_t low = first == 0xE0 ? 0xA0 : first == 0xF0 ? 0x90 : 0x80;
    uint8_t high = first == 0xED ? 0x9F : first == 0xF4 ? 0x8F : 0xBF;
    for (; more; more--, low = 0x80, high = 0xBF) {
        if (**at < low || **at > high)
            return 0xFFFD;
        value = value << 6 | (*(*at)++ & 63);
    }
    return value;
}

/* Write a text as sioms.protocol.text.printable does it, in at most four times its length. */
static void put_printable(char *to, const char *text)
{
    const uint8_t *at = (const uint8_t *)text, *begin;
    while (*(begin = at)) {
        uint32_t c = take_character(&at);
        size_t i = 0;
        while (UNPRINTABLE[i].last < c)
            i++;
        if (c == '\t' || c == '\n' || c == '\r')
            to += sprintf(to, "\\%c", c == '\t' ? 't' : c == '\n' ? 'n' : 'r');
        else if (UNPRINTABLE[i].first <= c)
            to += sprintf(to, c < 0x100 ? "\\x%02x" : c < 0x10000 ? "\\u%04x" : "\\U%08x", c);
        else if (c == 0xFFFD)
            to += sprintf(to, "\xEF\xBF\xBD");
        else
            to += sprintf(to, "%.*s", (int)(at - begin), begin);
    }
    *to = 0;
}

/* ---- the sources that this was made of ------------------------------------------------------ */

static uint32_t crc_of(uint32_t crc, const uint8_t *data, size_t size)
{
    static uint32_t table[256];
    for (uint32_t i = 0; !table[255] && i < 256; i++) {
        table[i] = i;
        for (int bit = 0; bit < 8; bit++)
            table[i] = table[i] & 1 ? table[i] >> 1 ^ 0xEDB88320u : table[i] >> 1;
    }
    crc = ~crc;
    while (size--)
        crc = table[(crc ^ *data++) & 255] ^ crc >> 8;
    return ~crc;
}

/* Whether the tree around this program still has the sources that it was made of. */
static int is_of_these_sources(void)
{
    static uint8_t text[MOST_SOURCE + 1];
    char place[4096];
    ssize_t length = readlink("/proc/self/exe", place, sizeof place - 128);
    uint32_t crc = 0;
    if (length <= 0)
        return 0;
    place[length] = 0;
    for (int up = 0; up < 3; up++) {
        char *slash = strrchr(place, '/');
        if (!slash)
            return 0;
        *slash = 0;
    }
    char *end = place + strlen(place);
    for (size_t i = 0; i < sizeof SOURCES / sizeof *SOURCES; i++) {
        snprintf(end, 128, "/%s", SOURCES[i]);
        int fd = open(place, O_RDONLY | O_CLOEXEC);
        ssize_t size = fd < 0 ? -1 : read(fd, text, sizeof text);
        if (size < 0)
            return 0;
        close(fd);
        crc = crc_of(crc, text, size);
    }
    return crc == CHECKSUM;
}

/* ---- messages: MessagePack, of which only what answers hold is known --------------------------- */

struct message {
    const uint8_t *at, *end;
};

static uint64_t take_bytes(struct message *m, int size)
{
    uint64_t value = 0;
    if (m->end - m->at < size)
        leave_to_python();
    while (size--)
        value = value << 8 | *m->at++;
    return value;
}

static int64_t take_integer(struct message *m)
{
    int kind = take_bytes(m, 1);
    if (kind < 0x80)
        return kind;
    if (kind >= 0xE0)
        return kind - 0x100;
    if (kind >= 0xCC && kind <= 0xCF)
        return take_bytes(m, 1 << (kind - 0xCC));
    if (kind < 0xD0 || kind > 0xD3)
        leave_to_python();
    int size = 1 << (kind - 0xD0), unused = 64 - 8 * size;
    return (int64_t)(take_bytes(m, size) << unused) >> unused;
}

static int64_t take_array(struct message *m)
{
    int kind = take_bytes(m, 1);
    if (kind >= 0x90 && kind < 0xA0)
        return kind & 15;
    if (kind != 0xDC && kind != 0xDD)
        leave_to_python();
    return take_bytes(m, kind == 0xDC ? 2 : 4);
}

static void pass(struct message *m, int depth)
{
    int kind = take_bytes(m, 1);
    uint64_t bytes = 0, values = 0;
    if (depth > MOST_DEPTH || kind == 0xC1 || (kind >= 0xC7 && kind <= 0xC9) || (kind >= 0xD4 && kind <= 0xD8))
        leave_to_python();
    if (kind >= 0x80 && kind < 0x90)
        values = 2 * (kind & 15);
    else if (kind >= 0x90 && kind < 0xA0)
        values = kind & 15;
    else if (kind >= 0xA0 && kind < 0xC0)
        bytes = kind & 31;
    else if (kind >= 0xC4 && kind <= 0xC6)
        bytes = take_bytes(m, 1 << (kind - 0xC4));
    else if (kind == 0xCA || kind == 0xCB)
        bytes = kind == 0xCA ? 4 : 8;
    else if (kind >= 0xCC && kind <= 0xD3)
        bytes = 1 << (kind & 3);
    else if (kind >= 0xD9 && kind <= 0xDB)
        bytes = take_bytes(m, 1 << (kind - 0xD9));
    else if (kind >= 0xDC && kind < 0xE0)
        values = take_bytes(m, kind & 1 ? 4 : 2) * (kind >= 0xDE ? 2 : 1);
    if (bytes > (uint64_t)(m->end - m->at) || values > (uint64_t)(m->end - m->at))
        leave_to_python();
    m->at += bytes;
    while (values--)
        pass(m, depth + 1);
}

static void take_text(struct message *m, char *text, size_t room)
{
    int kind = take_bytes(m, 1);
    size_t length = kind >= 0xA0 && kind < 0xC0 ? (size_t)(kind & 31)
                    : kind == 0xD9              ? take_bytes(m, 1)
                    : kind == 0xDA              ? take_bytes(m, 2)
                                                : room;
    if (length >= room || length > (size_t)(m->end - m->at))
        leave_to_python();
    memcpy(text, m->at, length);
    text[length] = 0;
    m->at += length;
}

/* ---- the command line ------------------------------------------------------------------------ */

struct flags {
    int given[128];
    double value[128];
};

static int is_numeric(const char *word)
{
    word += *word == '+' || *word == '-';
    word += *word == '.';
    return *word >= '0' && *word <= '9';
}

static const char *number_end(const char *at)
{
    const char *end = at + (*at == '+' || *at == '-'), *start = end;
    while ((*end >= '0' && *end <= '9') || *end == '.')
        end++;
    if (end > start && (*end == 'e' || *end == 'E')) {
        const char *exponent = end + 1 + (end[1] == '+' || end[1] == '-');
        if (*exponent >= '0' && *exponent <= '9')
            for (end = exponent; *end >= '0' && *end <= '9'; end++)
                ;
    }
    return end;
}

static void take_group(const char *at, struct flags *next, struct flags *all)
{
    if (!*at)
        leave_to_python();
    while (*at) {
        const struct option *option = OPTIONS;
        while (option->letter && option->letter != *at)
            option++;
        if (!option->letter)
            leave_to_python();
        double value = 0;
        const char *end = ++at;
        if (option->valued) {
            char *parsed;
            end = number_end(at);
            value = strtod(at, &parsed);
            if (end == at || parsed != end || !(value >= option->low && value <= option->high)
                || (option->whole && value != floor(value)))
                leave_to_python();
        }
        at = end;
        struct flags *owner = option->for_all ? all : next;
        owner->given[(int)option->letter] = 1;
        owner->value[(int)option->letter] = value;
    }
}

/* Whether a word can be nothing but the name of a node: no path, and no link that may lead to one. */
static int is_plain_name(const char *word)
{
    struct stat found;
    if (!*word || *word == '-' || is_numeric(word) || strlen(word) >= MOST_NAME)
        return 0;
    for (const char *c = word; *c; c++)
        if (*c == '/' || *c <= ' ' || *c > '~')
            return 0;
    return lstat(word, &found) || !S_ISLNK(found.st_mode);
}

/* The structures that -l, -h and -n choose. */
static void choose_channels(const struct flags *flags, int64_t count, int64_t *low, int64_t *high)
{
    const int *given = flags->given;
    if (given['n'] && (given['l'] || given['h']))
        leave_to_python();
    *low = given['n'] ? flags->value['n'] : given['l'] ? flags->value['l'] : 0;
    *high = given['n'] ? flags->value['n'] : given['h'] ? flags->value['h'] : count - 1;
    if (*low < 0 || *low > *high || *high >= count)
        leave_to_python();
}

/* See to it that no socket becomes standard input or output where the caller has closed them. */
static void occupy_standard_descriptors(void)
{
    for (int fd = 0; fd < 3; fd++)
        if (fcntl(fd, F_GETFD) < 0 && open("/dev/null", fd ? fd == 1 ? O_RDONLY : O_RDWR : O_WRONLY) < 0)
            leave_to_python();
}

/* ---- the daemon ------------------------------------------------------------------------------- */

static const char *own_path(void)
{
    static char path[4096];
    const char *runtime = getenv("XDG_RUNTIME_DIR");
    if (runtime && *runtime)
        snprintf(path, sizeof path, "%s/sioms/siomsd.sock", runtime);
    else
        snprintf(path, sizeof path, "/tmp/sioms-%u/sioms/siomsd.sock", getuid());
    return path;
}

static int may_serve(uid_t uid, const char *path)
{
    char folder[sizeof(struct sockaddr_un)];
    struct stat found;
    if (uid == 0 || uid == getuid())
        return 1;
    snprintf(folder, sizeof folder, "%s", path);
    char *slash = strrchr(folder, '/');
    if (!slash || slash == folder || !strcmp(path, own_path()))
        return 0;
    *slash = 0;
    return !stat(folder, &found) && uid == found.st_uid;
}

static int connect_to_daemon(void)
{
    const char *path = getenv(CELL_VARIABLE);
    if (!path || !*path)
        path = getenv(SOCKET_VARIABLE);
    if (!path || !*path)
        path = access(SYSTEM_PATH, F_OK) ? own_path() : SYSTEM_PATH;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    struct timeval patience = {.tv_usec = PATIENCE_US};
    struct ucred peer;
    socklen_t size = sizeof peer;
    int sock = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    if (sock < 0 || strlen(path) >= sizeof address.sun_path || strstr(path, "://"))
        leave_to_python();
    strcpy(address.sun_path, path);
    setsockopt(sock, SOL_SOCKET, SO_SNDTIMEO, &patience, sizeof patience);
    setsockopt(sock, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    if (connect(sock, (struct sockaddr *)&address, sizeof address)
        || getsockopt(sock, SOL_SOCKET, SO_PEERCRED, &peer, &size) || !may_serve(peer.uid, path))
        leave_to_python();
    return sock;
}

/* Send a request and return the errno of its answer, whose value begins where the message is left. */
static int ask(int sock, const void *packet, size_t size, int64_t number, struct message *m, int *fds, int *fd_count)
{
    static uint8_t answer[MAX_PACKET];
    union {
        char bytes[CMSG_SPACE(4 * sizeof(int))];
        struct cmsghdr align;
    } control;
    struct iovec part = {answer, sizeof answer};
    struct msghdr head = {.msg_iov = &part, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    if (send(sock, packet, size, MSG_NOSIGNAL) != (ssize_t)size)
        leave_to_python();
    ssize_t got = recvmsg(sock, &head, MSG_CMSG_CLOEXEC);
    if (got <= 0)
        leave_to_python();
    *fd_count = 0;
    for (struct cmsghdr *c = CMSG_FIRSTHDR(&head); c; c = CMSG_NXTHDR(&head, c))
        if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SCM_RIGHTS) {
            *fd_count = (c->cmsg_len - CMSG_LEN(0)) / sizeof(int);
            memcpy(fds, CMSG_DATA(c), *fd_count * sizeof(int));
        }
    *m = (struct message){answer, answer + got};
    int64_t parts = take_array(m);
    if (parts < 4 || parts > 6 || take_integer(m) != 0 || take_integer(m) != number)
        leave_to_python();
    int refused = take_integer(m);
    struct message rest = *m;
    pass(&rest, 0);
    if (parts > 4 && (rest.at >= rest.end || *rest.at != 0xC2)) /* compressed: of thousands of channels */
        leave_to_python();
    return refused;
}

static int ask_open(int sock, const char *name, struct message *m, int *fds, int *fd_count)
{
    static int64_t number = OPEN_NUMBER;
    uint8_t packet[sizeof OPEN_HEAD + sizeof OPEN_TAIL + MOST_NAME + 16];
    size_t n = sizeof OPEN_HEAD, length = strlen(name);
    memcpy(packet, OPEN_HEAD, n);
    packet[n++] = 0xD9;
    packet[n++] = length;
    memcpy(packet + n, name, length);
    n += length;
    memcpy(packet + n, OPEN_TAIL, sizeof OPEN_TAIL);
    return ask(sock, packet, n + sizeof OPEN_TAIL, number, m, fds, fd_count);
}

static void take_line(char **words);

/* Be the tool whose words these are, with signals and descriptors as the one in Python has them; argv: this program, then
 * the command that the tool in Python is, of which the words begin at FIRST_WORD.
 */
static void be_tool(int argc, char **argv)
{
    arguments = argv;
    if (argc < FIRST_WORD || !is_of_these_sources())
        leave_to_python();
    take_line(argv + FIRST_WORD);
    signal(SIGINT, SIG_DFL);
    signal(SIGPIPE, SIG_DFL);
    prctl(PR_SET_NAME, TOOL);
    occupy_standard_descriptors();
}
